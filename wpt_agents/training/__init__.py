"""How an agent learns: updates, pre-training, rollouts, guidance, checks of user input."""
