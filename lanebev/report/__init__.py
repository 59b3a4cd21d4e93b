"""What a person looks at: overlay, plots, page."""
