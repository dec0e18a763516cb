"""Faster versions of functions that `wpt_agents.model` defines; importing it registers them."""

from wpt_agents.fast import acting as acting
from wpt_agents.fast import compiled as compiled
from wpt_agents.fast import convolutions as convolutions
from wpt_agents.fast import pieces as pieces
from wpt_agents.fast import products as products
from wpt_agents.fast import scan as scan
from wpt_agents.fast import shifts as shifts
