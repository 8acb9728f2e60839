"""The paragraph on where rank goes has its numbers from the results."""

from studies.paper.book import Book
from studies.paper.rank_text import where_rank_goes

BOXES = {
    "vision": {"fc1": [[1, 30, 40, 50, 64], [1, 10, 20, 30, 64]], "head": [[1, 1, 12, 20, 60]]},
    "language": {"q_proj": [[1, 4, 6, 8, 9], [1, 6, 8, 10, 11]]},
    "action": {
        "self_layer/k_proj": [[1, 10, 20, 30, 40], [1, 2, 3, 4, 5]],
        "cross_layer/k_proj": [[1, 2, 3, 4, 5], [1, 8, 10, 12, 20]],
        "state_proj": [[1, 1, 2, 3, 4]],
    },
}
NAMES = ("smolvla/multi/lora_r64/s0", "smolvla/multi/lora_sp/s0", "smolvla/multi/lora_sp/s1")


def cell(vision):
    ranks = {"vision": vision, "language": 7.0, "action": 9.0}
    return {"active_rank": ranks, "measures": {"rank_boxes": BOXES}}


def test_numbers():
    results = {NAMES[1]: cell(24.0), NAMES[2]: cell(26.0)}
    text = where_rank_goes(Book(NAMES, results))
    assert text == (
        "**SmolVLA**: on average, a token uses 25.0 of 64 directions in vision, 7.0 in language "
        "and 9.0 in action.\n\n"
        '<details markdown="1">\n<summary>Layers, depth and tokens</summary>\n\n'
        "The median over tokens is highest in vision `fc1` (30), vision `head` "
        "(12), action `k` (9), and lowest in action `state` (2), language `q` (7), "
        "action `k` (9). From the first layer to the last, it goes from 40 to 20 in vision, "
        "from 6 to 8 in language and from 20 to 10 in action. Within one layer, the middle half "
        "of the tokens spans 19.5 ranks in vision, 4.0 in language and 4.5 in action."
        "\n\n</details>\n"
    )


def test_missing_runs():
    text = where_rank_goes(Book(NAMES, {NAMES[1]: cell(24.0)}))
    assert text == "**SmolVLA**: 1 of 2 runs so far.\n"
