"""The road: ``alignment``, ``layout`` of the boundaries (``city_layout``), ``pavement``, ``glyphs`` on it."""
