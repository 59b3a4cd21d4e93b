"""Training of the segmentation model: ``python -m train fit --config configs/default.yaml``.

- Step: ``module``, with ``losses``, ``metrics``, ``scores`` and ``backbone``; ``end_to_end`` by ``poses``.
- Data: ``data`` of a ``pool`` of frames on disk (``archives``), ``live`` rendered (``rendering``), or
  ``datasets`` of your own, also with ``pseudo_labels``; ``labels`` and ``maps`` are the targets.
- Weights: ``export``, ``average``. Measured by ``evaluate_roads``, ``evaluate_poses``, ``noise`` (``drives``)
  and ``extraction``.
- On a GPU: ``gpu_run`` (``processes``, ``budget``), ``smoke``, ``throughput`` and ``stopwatch``.
- ``detector`` measures what a detector of vehicles gains from the pose. ``commands`` serves all.
"""
