"""`python -m wpt_agents.zoo`; the commands are in `wpt_agents.zoo.commands`."""

import sys

if __name__ == "__main__":
    try:
        from wpt_agents.zoo.commands.app import main
    except ModuleNotFoundError as error:
        print(f'{error.name} is not installed: pip install "wpt-agents[all]"', file=sys.stderr)
        sys.exit(2)
    main()
