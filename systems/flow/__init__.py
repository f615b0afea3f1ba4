"""Optical flow over a spherical shell: points tracked in pictures, and the motion they tell."""
