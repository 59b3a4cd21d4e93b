"""Objects on the ground.

Vehicles, signs and poles: ``objects`` are ``hexahedra`` with ``shading``. ``walls`` beside the road have a
``wall_texture``, or are ``houses``; ``tunnel`` is around the road.
"""
