"""The folder of a run's results.

``folder`` makes it, ``lock`` keeps other runs out, and ``whole_file`` leaves no file half-written.
"""
