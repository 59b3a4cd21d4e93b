"""The road: ``alignment``, ``layout`` of the boundaries (``city_layout``) and ``pavement``."""
