"""The blocks: sensors, markers, estimators, controllers, each a Drake `LeafSystem`."""

__distribution__ = "tagtrail"
