"""Ratios and tables from the results of all processes."""

import statistics
from collections.abc import Iterable
from typing import Any

from benchmarks.peers.cases import TABLES

Result = dict[str, Any]
"""A case's table, program and variant with the worker's result, or with its `error`."""


def references(results: Iterable[Result]) -> dict[tuple[str, str], float]:
    """Return the time [s] of each table's reference by (table, item): the mean of its runs."""
    runs: dict[tuple[str, str], list[float]] = {}
    for result in results:
        if (result["program"], result["variant"]) != TABLES[result["table"]][0]:
            continue
        for row in result.get("rows", []):
            runs.setdefault((result["table"], row["item"]), []).append(row["median_s"])
    return {key: statistics.mean(times) for key, times in runs.items()}


def rows(results: list[Result], table: str) -> list[dict[str, Any]]:
    """Return the lines of one table: times, and ratios to the reference of the same item.

    A ratio above 1 means that the reference is faster. Where the reference failed, it is empty.
    """
    times, lines = references(results), []
    for result in results:
        for row in result.get("rows", []) if result["table"] == table else []:
            reference, samples = times.get((table, row["item"])), row.get("samples")
            lines.append(
                {
                    "program": result["program"],
                    "variant": result["variant"],
                    "item": row["item"],
                    "ms": 1e3 * row["median_s"],
                    "samples/s": samples / row["median_s"] if samples else "",
                    "ratio": row["median_s"] / reference if reference else "",
                    "trained": float(row["trainable"]) if "trainable" in row else "",
                    "GiB": row["gib"] if row.get("gib") else "",
                }
            )
    return lines


def versions(results: Iterable[Result]) -> dict[str, dict[str, str]]:
    """Return program -> package -> version."""
    return {result["program"]: result["versions"] for result in results if "versions" in result}
