"""The commands.

``run``, whose results ``summary`` puts in words, ``demo``, ``compare``, ``convert``, ``doctor``, ``export``
and ``fleet``. ``config`` has their settings; a run is made of ``drive``, ``recording`` and ``continued``.
``concurrency`` and ``progress`` serve all of them.
"""
