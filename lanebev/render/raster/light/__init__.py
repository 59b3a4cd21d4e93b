"""Light: the ``sky``, ``shadows`` on the ground, and lamps at ``night``."""
