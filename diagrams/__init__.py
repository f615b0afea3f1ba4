"""The wiring: scenarios, stations, one file for each robot, reports and the command line."""

__distribution__ = "tagtrail"
