"""Draws docs/layers.svg, the layers of the source: `python docs/draw_layers.py`."""

from html import escape
from pathlib import Path

# From top to bottom: the folder, what it is, and what it contains. A folder imports from itself
# and from the folders below it; tests/test_architecture.py checks this.
LAYERS = [
    ("zoo", "runs agents", "command line, presets, collecting, engines, evaluation, report, bench"),
    (
        "agents",
        "one algorithm per file",
        "WPT (Algorithm 1), DrQ-v2, RLPD, JSRL, R3M, PackNet, MR.Q, curiosity",
    ),
    (
        "training",
        "how an agent learns",
        "learner, keywords, pre-training, rollouts, guidance, many GPUs",
    ),
    ("fast", "the same functions, faster", "twins of definitions for a CPU or a GPU"),
    (
        "model",
        "networks and losses of the paper",
        "RSSM, world model, actor, critic, prior actor, policy",
    ),
    (
        "data",
        "what models learn from",
        "trajectories, dataset on disk, importers, replay, retrieval",
    ),
    ("files", "safe reading and writing", "archives, model files, checked names"),
]
WIDTH, BOX, HEIGHT, GAP, LEFT, TOP = 960, 660, 62, 16, 20, 20
COLOURS = ["#e8eefc", "#e3f3ee", "#e3f3ee", "#fdf3dc", "#fdf3dc", "#f5e8f3", "#ececec"]


def text(
    x: float,
    y: float,
    words: str,
    size: int = 15,
    weight: str = "normal",
    colour: str = "#1d2433",
    anchor: str = "start",
) -> str:
    """One line of text."""
    return (
        f'<text x="{x}" y="{y}" font-size="{size}" font-weight="{weight}" fill="{colour}" '
        f'text-anchor="{anchor}">{escape(words)}</text>'
    )


def box(x: float, y: float, width: float, height: float, colour: str) -> str:
    """A rounded rectangle."""
    return (
        f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{colour}" '
        f'stroke="#5b6478"/>'
    )


def arrow(x0: float, y0: float, x1: float, y1: float) -> str:
    """A line with a head at (x1, y1)."""
    return (
        f'<line x1="{x0}" y1="{y0}" x2="{x1}" y2="{y1}" stroke="#5b6478" stroke-width="1.6" '
        'marker-end="url(#head)"/>'
    )


def draw() -> str:
    """The whole drawing, as SVG."""
    height = TOP * 2 + len(LAYERS) * (HEIGHT + GAP) + 20
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
        f'height="{height}" font-family="Helvetica, Arial, sans-serif" role="img" '
        'aria-label="The layers of wpt_agents: zoo, agents, training, fast, model, data, files">',
        '<defs><marker id="head" markerWidth="9" markerHeight="9" refX="8" refY="4.5" '
        'orient="auto"><path d="M0,0 L9,4.5 L0,9 z" fill="#5b6478"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    for number, ((name, what, contents), colour) in enumerate(zip(LAYERS, COLOURS, strict=True)):
        y = TOP + number * (HEIGHT + GAP)
        parts += [
            box(LEFT, y, BOX, HEIGHT, colour),
            text(LEFT + 18, y + 27, f"wpt_agents/{name}", 16, "bold"),
            text(LEFT + BOX - 18, y + 27, what, 15, anchor="end"),
            text(LEFT + 18, y + 48, contents, 13, colour="#414a5c"),
        ]
        if number:
            parts.append(arrow(LEFT + BOX / 2, y - GAP, LEFT + BOX / 2, y))
    right = LEFT + BOX + 70
    parts += [
        box(right, TOP, 190, HEIGHT, "#ffffff"),
        text(right + 95, TOP + 27, "envs/wpt_envs", 16, "bold", anchor="middle"),
        text(right + 95, TOP + 48, "tasks from pixels", 13, colour="#414a5c", anchor="middle"),
        arrow(LEFT + BOX, TOP + HEIGHT / 2, right, TOP + HEIGHT / 2),
        text(right, TOP + HEIGHT + 32, "wpt_envs imports", 13, colour="#414a5c"),
        text(right, TOP + HEIGHT + 50, "neither torch nor wpt_agents;", 13, colour="#414a5c"),
        text(right, TOP + HEIGHT + 68, "only the zoo imports it.", 13, colour="#414a5c"),
        text(LEFT, height - 16, "A folder imports from itself and from the folders below it.", 14),
    ]
    return "\n".join([*parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    (Path(__file__).parent / "layers.svg").write_text(draw())
