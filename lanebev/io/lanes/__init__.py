"""Lane files.

- ``files`` finds out the format of a file, reads it and matches its entries to images.
- Formats: ``tusimple``, ``culane``, ``curvelanes``, ``openlane``, ``llamas``, ``bdd100k``,
  ``annotators``, ``lanes3d``; they share ``parsing``.
- ``remarks`` and ``doubts`` about lanes, about the ``size`` of their images and the
  ``contrast`` along them.
"""

from lanebev.io.lanes.files import lane_files, match_frames, read_lanes

__all__ = ["lane_files", "match_frames", "read_lanes"]
