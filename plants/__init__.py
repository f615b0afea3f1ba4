"""Robots and worlds as `MultibodyPlant` models, and their kinematic twins."""

__distribution__ = "tagtrail"
