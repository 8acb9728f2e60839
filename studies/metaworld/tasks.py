"""The fifty tasks of Meta-World: an instruction for each, and the usual groups by difficulty.

Groups: Seo et al., Masked World Models for Visual Control, 2022, appendix.
"""

import zlib

INSTALL = "pip install metaworld==3.1.1 packaging pyarrow lazy_loader msgpack websockets"
"""Installs what recording and judging need, in an environment of its own."""

GROUPS = {
    "easy": {
        "button-press": "push the button on the front of the box",
        "button-press-topdown": "press the button down from above",
        "button-press-topdown-wall": "reach over the wall and press the button down",
        "button-press-wall": "go past the wall and push the button",
        "coffee-button": "start the coffee machine with its button",
        "dial-turn": "turn the dial",
        "door-close": "swing the safe door shut",
        "door-lock": "turn the lock down to lock the door",
        "door-open": "pull the safe door open",
        "door-unlock": "turn the lock up to unlock the door",
        "drawer-close": "push the drawer shut",
        "drawer-open": "pull the drawer open",
        "faucet-close": "turn the faucet off",
        "faucet-open": "turn the faucet on",
        "handle-press": "press the handle down",
        "handle-press-side": "press the sideways handle down",
        "handle-pull": "lift the handle up",
        "handle-pull-side": "lift the sideways handle up",
        "lever-pull": "raise the lever",
        "peg-unplug-side": "pull the peg out of the socket",
        "plate-slide": "slide the plate into the goal",
        "plate-slide-back": "drag the plate out of the goal",
        "plate-slide-back-side": "drag the plate sideways out of the goal",
        "plate-slide-side": "slide the plate sideways into the goal",
        "reach": "move the hand to the red point",
        "reach-wall": "move the hand around the wall to the point",
        "window-close": "slide the window shut",
        "window-open": "slide the window open",
    },
    "medium": {
        "basketball": "drop the ball through the hoop",
        "bin-picking": "carry the block to the other bin",
        "box-close": "put the lid on the box",
        "coffee-pull": "pull the mug away from the coffee machine",
        "coffee-push": "push the mug under the coffee machine",
        "hammer": "drive the nail in with the hammer",
        "peg-insert-side": "put the peg into the hole in the side",
        "push-wall": "push the puck around the wall",
        "soccer": "push the ball into the net",
        "sweep": "sweep the block off the table",
        "sweep-into": "sweep the block into the hole",
    },
    "hard": {
        "assembly": "put the ring over the peg",
        "hand-insert": "hold the block down in the hole",
        "pick-out-of-hole": "take the puck out of the hole",
        "pick-place": "lift the puck to the point",
        "push": "push the puck to the point",
        "push-back": "pull the block back to the point",
    },
    "very hard": {
        "disassemble": "take the ring off the peg",
        "pick-place-wall": "lift the puck over the wall",
        "shelf-place": "place the block on the shelf",
        "stick-pull": "pull the box with the stick",
        "stick-push": "push the box with the stick",
    },
}
"""Group -> task -> instruction."""
INSTRUCTIONS = {task: text for tasks in GROUPS.values() for task, text in tasks.items()}
"""Task -> instruction."""
HELD_OUT = ("bin-picking", "box-close", "door-lock", "door-unlock", "hand-insert")
"""The five tasks of ML45's test set: `metaworld.env_dict.ML45_V3["test"]`."""
EXTREME = (
    *("coffee-button", "dial-turn", "door-close", "drawer-close", "faucet-close", "handle-press"),
    *("handle-press-side", "handle-pull-side", "lever-pull", "plate-slide-side", "window-close"),
    *("basketball", "box-close", "peg-insert-side", "sweep", "sweep-into"),
    *("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push"),
    *("disassemble", "pick-place-wall", "shelf-place"),
)
"""Tasks in which the first pilots, which no table uses, succeed in less than a tenth or more than
four fifths of 120 episodes: they tell least about methods."""
FIRST = (5, 10, 25)
"""Sizes of the sets that grow to the fifty."""


def _order() -> tuple[str, ...]:
    """Return the fifty tasks in the order in which they join the sets of `FIRST`.

    The next one is always of the group of which the smallest share has joined, of equals the easier
    one. Within a group, the order is that of a checksum of the name, with `EXTREME` last.
    """
    share = {}
    for group in GROUPS.values():
        order = sorted(group, key=lambda task: (task in EXTREME, zlib.crc32(task.encode())))
        share |= {task: joined / len(order) for joined, task in enumerate(order)}
    return tuple(sorted(INSTRUCTIONS, key=share.__getitem__))


SETS = {
    "mt50": tuple(INSTRUCTIONS),
    "ml45": tuple(task for task in INSTRUCTIONS if task not in HELD_OUT),
    "ml5": HELD_OUT,
    **{f"first{size}": _order()[:size] for size in FIRST},
    **{task: (task,) for task in _order()[: FIRST[0]]},
}
"""Name of a set of tasks -> its tasks; ml45 is what a policy learns before ml5. The smallest of the
sets of `FIRST` also comes as sets of one task."""
