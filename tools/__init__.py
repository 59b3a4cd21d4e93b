"""Measurements and checks: each has ``--help``.

- Calibrators: ``reproduce_table1``, ``bench_calibration`` (by ``bench_kinds`` on ``random_drives``, beside
  ``known_road`` and ``textbook_ekf``), ``bench_mixed``, ``replay``, ``focal_information``.
- Real images: ``evaluate_real`` (``real_figures``), ``evaluate_streets`` (``single_images``) and
  ``evaluate_rotated``, all with ``network_options``; ``label_noise``, ``pseudo_ground_truth``.
- Time and memory: ``bench_speed``, ``bench_run``, ``bench_memory``, ``profile_joint``, ``render_cost`` (on
  ``other_device``).
- Exported files: ``bench_int8``, ``compare_onnx``. Fleets: ``fleet_check``, ``fleet_plan``.
- Robustness: ``fuzz_readers``, ``stream_check``. Pictures: ``readme_picture``, ``render_sheet``.
- ``write_golden`` writes references of the tests.
"""
