"""The main job: settings, the run over a source, its records, the demo."""
