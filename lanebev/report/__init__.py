"""Outputs for people: overlay, plots, page."""
