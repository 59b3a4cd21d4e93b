"""Images: their ``files``, ``names``, ``pixels``, and their times by ``name_clocks`` or ``time_files``."""
