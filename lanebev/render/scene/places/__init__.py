"""Kinds of place: a ``street`` in a ``town``, ``country`` roads, ``tunnel``, road ``works``, ``winter``."""
