"""ROS 2-native: pictures and tokens as topics under real ROS 2 names and types."""
