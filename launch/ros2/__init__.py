"""Exchange messages with ROS 2: define message types, map topics, and bridge them over DDS."""
