"""Outputs for people.

- ``page`` is report.html and ``comparison`` the page of two runs, which ``run_folder`` reads; ``templates``
  are their HTML. ``verdict`` has their words, ``plots``, ``timeline`` and ``lens_table`` their figures,
  ``figures`` the style, and ``axis_states`` the state of each quantity in each frame.
- ``overlay`` draws a frame with ``lane_curves`` and ``lettering``; ``pictures`` keeps the ``worst`` of them.
- ``measure`` measures lanes in the bird's-eye view.
"""
