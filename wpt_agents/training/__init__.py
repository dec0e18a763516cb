"""How an agent learns: updates, pre-training, rollouts, guidance, checks of what users pass."""
