"""Avoiders: around what the lidar sees, toward the goal. All have the same ports."""
