"""Runs on many drives.

``manifest`` lists the drives, ``plan`` makes tasks of them, with long videos in parts.
``queue`` orders them, ``cluster`` gives them to processes or machines, each a ``worker``. ``fleet`` does all
this, then ``collect`` gathers the results, ``mounts`` compares the mounts of each camera's drives, and
``page`` writes the index page.
"""
