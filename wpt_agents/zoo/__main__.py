"""`python -m wpt_agents.zoo`; the commands stand in `wpt_agents.zoo.commands`."""

from wpt_agents.zoo.commands.app import main

if __name__ == "__main__":
    main()
