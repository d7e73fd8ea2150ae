"""Exchange messages with ROS 2: types, the table of topics, and the bridge over DDS."""
