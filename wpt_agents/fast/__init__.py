"""Faster versions of functions that `wpt_agents.model` defines."""
