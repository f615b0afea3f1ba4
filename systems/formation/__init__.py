"""Formations of robots that stand as beacons for each other: geometry, sight, error models."""
