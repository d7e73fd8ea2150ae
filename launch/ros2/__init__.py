"""Exchange messages with ROS 2: message types, table of topics, and bridge over DDS."""
