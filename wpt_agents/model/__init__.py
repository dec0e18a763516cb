"""The paper's networks, distributions and losses."""
