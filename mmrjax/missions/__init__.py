"""Missions: a profile over time, with heat, events and energy."""
