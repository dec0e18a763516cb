"""The runner: python -m wpt_agents.zoo."""
