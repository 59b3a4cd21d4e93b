"""The outputs of a run.

``recorder`` writes them, with bird's-eye ``views``, and keeps numbers in compact ``storage``. Remarks:
``plausibility`` of the result, ``repeats`` of frames, ``view_changes``.
"""
