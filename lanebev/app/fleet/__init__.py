"""Runs on many drives.

``manifest`` lists the drives, ``plan`` makes tasks of them, with long videos in parts.
``cluster`` gives them to processes or machines, each a ``worker``. ``fleet`` does all this, then ``collect``
gathers the results, ``mounts`` compares the cars' and ``page`` reports.
"""
