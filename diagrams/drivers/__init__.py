"""Drivers: each wires one kind of device into a station, simulated or played back."""
