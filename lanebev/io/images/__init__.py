"""Images: their ``files``, their ``names`` and the times in those (``name_clocks``), their ``pixels``."""
