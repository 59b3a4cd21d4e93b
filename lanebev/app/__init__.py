"""The commands.

- Settings: ``config`` of a run and ``export_config``, from the ``options`` that ``arguments`` and
  ``settings_file`` read; ``completion`` in a shell.
- ``run``: ``sources`` gives the frames, ``build`` makes the parts, ``observers`` find boundaries, by a
  ``shared_network`` for several drives, and ``recorder`` writes the outputs, with ``views`` and ``storage``.
  ``summary`` says what came out.
- Continued and repeated runs: ``resume`` from a state, ``recovery`` after a run that was killed,
  ``smoothing`` in two passes, ``part_observation`` of long videos.
- Remarks: ``plausibility`` of the result, ``repeats`` of frames, ``view_changes``, ``source_changes``.
- Other commands: ``demo``, ``compare``, ``convert``, ``doctor``, ``export``, ``fleet``.
- ``concurrency``, ``signals`` and ``progress`` serve all of them.
"""
