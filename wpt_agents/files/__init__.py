"""Archives and model files, written atomically and without pickle."""
