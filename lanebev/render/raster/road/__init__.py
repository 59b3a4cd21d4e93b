"""The ground.

``ground`` puts together the ``surface``, its ``markings`` and ``symbols``, the ``verge``, and ``varied``
kinds of road: a ``street`` with ``street_surface``, ``roadside`` and painted ``glyphs``, and ``winter``.
"""
