"""The ground.

``ground`` puts together the ``surface``, its ``markings`` and ``symbols``, the ``verge``, and what only some
kinds of road have: a ``street`` with ``street_surface``, ``roadside`` and ``glyphs``; ``winter``; ``works``.
"""
