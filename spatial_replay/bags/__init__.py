"""Logs of messages that other software recorded: ROS 1 and ROS 2 bags, MCAP in any encoding."""
