"""The registrar in a ROS world: a bridge that ROS nodes load by, its client for nodes, and what both versions share."""
