"""A run's results in formats of other programs.

``names`` lists the formats, ``folder`` reads a run's folder, and ``record`` has what all formats share. They
are ``jsonl``, ``kitti``, ``mcap``, ``nuscenes``, ``opencv``, ``openpilot``, ``parquet``, ``rerun``,
``ros_camera_info`` and ``ros_tf``.
"""
