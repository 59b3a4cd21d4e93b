"""The commands: settings, the run over a source, its recorder, the demo."""
