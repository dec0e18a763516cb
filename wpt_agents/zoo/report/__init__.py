"""Reports on run folders: tables for a terminal, and an HTML page."""
