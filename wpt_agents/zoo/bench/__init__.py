"""What one update, one action and one batch cost, as measured on this machine."""
