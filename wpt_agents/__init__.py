"""WPT: generalist world-model pre-training for efficient reinforcement learning from pixels."""
