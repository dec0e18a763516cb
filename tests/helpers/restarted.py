"""What torchrun starts in test_distributed.py: connects twice; at first rank 1 dies in between."""

import os

import torch

from wpt_agents.training.distributed import joined

attempt = os.environ["TORCHELASTIC_RESTART_COUNT"]
for meeting in range(2):
    with joined(torch.device("cpu")) as world:
        world.barrier()
        if (attempt, world.rank, meeting) == ("0", 1, 1):
            os._exit(1)
        world.barrier()
        print(f"rank {world.rank}, attempt {attempt}, meeting {meeting}", flush=True)
