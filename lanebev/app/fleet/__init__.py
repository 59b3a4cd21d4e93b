"""Many drives in parallel, on the cores of one machine or of a cluster."""
