"""Files and streams, in and out.

- Frames: ``opening`` makes a ``frame_source`` of ``frames`` of a video or of images; ``bags`` and ``live``
  are other sources, ``source_names`` tells them apart. ``video`` and ``images`` decode what is inside;
  ``side_by_side`` tells that a frame shows two cameras, ``frozen_images`` that a camera gives the same
  image again. Times: ``frame_clock``, ``rising_clock``. ``speeds`` are the vehicle's.
- Lanes: ``lanes`` reads all kinds of lane files.
- Outputs: ``results``, ``covariances``, ``calibration_file``, ``state``, and ``formats`` of other programs;
  ``output`` keeps the folder and its files whole.
"""
