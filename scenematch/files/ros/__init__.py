"""ROS bags and messages: readers and writers, without ROS."""
