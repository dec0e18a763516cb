"""The tasks that dm_control does not have, in dm_control's layout."""
