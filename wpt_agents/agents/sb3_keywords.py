"""Errors for keywords that agents of Stable-Baselines3 have and these agents do not."""

from collections.abc import Collection

from wpt_agents.files.names import unknown_name

WHOLE_EPISODES = "The replay buffer keeps every episode, whole"
FROM_THE_ACTOR = "The actor explores by the standard deviation that it learns"
# The replacement, if there is one, and what to know about it.
SB3_KEYWORDS: dict[str, tuple[str | None, str]] = {
    "action_noise": ("ent_coef", FROM_THE_ACTOR),
    "buffer_size": (None, WHOLE_EPISODES),
    "gae_lambda": ("lam", ""),
    "gradient_steps": ("train_ratio", "It counts replayed steps for each step of the environment"),
    "max_grad_norm": ("grad_clip", ""),
    "n_steps": ("batch_length", "Sequences are replayed, not the last steps of each environment"),
    "optimize_memory_usage": (None, WHOLE_EPISODES),
    "policy_kwargs": ("size", "It sets the widths of all networks"),
    "replay_buffer_class": (None, WHOLE_EPISODES),
    "replay_buffer_kwargs": (None, WHOLE_EPISODES),
    "sde_sample_freq": ("ent_coef", FROM_THE_ACTOR),
    "stats_window_size": (None, "Logged means are over 100 episodes, as by default in SB3"),
    "target_entropy": ("ent_coef", "The weight of the entropy is a number or a schedule"),
    "target_update_interval": ("target_fraction", "The target critic is a moving average"),
    "tau": ("target_fraction", "The target critic is a moving average"),
    "use_sde": ("ent_coef", FROM_THE_ACTOR),
}


def unknown_keyword(name: str, valid: Collection[str]) -> TypeError:
    """Return the error for an unknown keyword; for one of SB3, it names the replacement."""
    replacement, note = SB3_KEYWORDS.get(name, (None, ""))
    if name not in SB3_KEYWORDS or not (replacement is None or replacement in valid):
        return TypeError(str(unknown_name("keyword", name, valid)))
    instead = f"leave {name!r} out" if replacement is None else f"use {replacement!r} instead"
    sentence = f". {note}" if note else ""
    return TypeError(f"No keyword {name!r} as in Stable-Baselines3: {instead}{sentence}")
