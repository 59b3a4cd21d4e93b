"""A run's results in formats of other programs.

``names`` lists the formats, ``folder`` writes them from a run's folder, and ``record`` has what they share,
``table`` what ``jsonl`` and ``parquet`` share. The others are ``kitti``, ``mcap``, ``nuscenes``, ``opencv``,
``openpilot``, ``rerun``, ``ros_camera_info`` and ``ros_tf``.
"""
