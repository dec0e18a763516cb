"""`python -m wpt_agents.zoo`; the commands are in `wpt_agents.zoo.commands`."""

import os
import sys

if __name__ == "__main__":
    # Threads that wait by sleeping leave the core to others. OpenMP reads this when torch is
    # loaded, here and in the processes that the zoo starts.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        from wpt_agents.zoo.commands.app import main
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("wpt_agents"):
            raise  # a fault of ours, not a missing package
        print(f'{error.name} is not installed: pip install "wpt-agents[all]"', file=sys.stderr)
        sys.exit(2)
    main()
