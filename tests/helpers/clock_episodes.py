"""An agent that learns from the clock, and whether its episodes are stored as they were seen."""

from debug_agent import agent, on_time


def learnt(env, steps=42):
    return agent(env, learning_starts=0, train_ratio=1).learn(steps)  # an update in 8 steps


def stored(model):
    return model.replay_buffer.trajectories


def all_on_time(model, count):
    """Whether there are that many episodes of the clock, each image in its place."""
    return len(stored(model)) == count and all(on_time(episode) for episode in stored(model))
