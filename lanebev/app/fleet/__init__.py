"""Many drives at once, on the cores of one machine or of a cluster."""
