"""Files and streams, in and out.

- Frames: ``video`` opens videos and images as a ``frame_source`` of ``frames``, ``bags`` (``bag_messages``)
  and ``live`` the other sources; ``source_names`` tells them apart. Videos: ``decoding``, ``seeking``,
  ``video_remarks``, ``side_by_side``, ``video_writer``. Images: ``images``, ``image_files``, ``image_names``,
  ``name_clocks``. Times: ``frame_clock``, ``rising_clock``.
- Lanes: ``lanes`` reads files of ``tusimple``, ``culane``, ``curvelanes``, ``openlane``, ``llamas``,
  ``bdd100k`` and ``labelme`` by ``lane_parsing``. Remarks on them: ``lane_doubts``, ``lane_order``,
  ``lane_repeats``, ``lane_size``, ``lane_widths``.
- Outputs: ``output_folder``, ``results``, ``covariances``, ``calibration_file``, ``state``, and ``formats``
  of other programs; ``whole_file``, ``folder_lock`` and ``late_signals`` keep them whole.
"""
