"""Daylight and ``weather``; lamps at ``night``."""
