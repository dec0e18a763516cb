"""The tasks which dm_control does not have, in its own layout."""
