"""The ten claims of the study of studies/paper/study.py, decided before its cells run.

Success is averaged over the four tasks. Differences are paired on seeds and layouts. R is the size
of LoRA-SP's bank.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lorasp_jax.extras.study import statistics
from lorasp_jax.extras.study.statistics import Estimate
from lorasp_jax.extras.study.study import Results
from studies.paper import estimates, naming, published
from studies.paper.criteria import Claim, Criterion
from studies.paper.naming import TOWERS

LESS_IS_NOTHING = "the paper states no amount, so any difference counts that the interval confirms"
THREE_POINTS = (
    "our choice: about two of the paper's 60 episodes per method, its rates being multiples of 1/15"
)


def make_claims(names: Sequence[str], rank: int, backbones: Sequence[str]) -> tuple[Claim, ...]:
    """Return the claims, with tests where the named cells suffice; `rank` is R."""
    make = _Maker(tuple(names), rank)
    return tuple(
        Claim(number, statement, paper, {b: c for b in backbones if (c := criteria(make, b))})
        for number, (statement, paper, criteria) in enumerate(CLAIMS, 1)
    )


class _Maker:
    """Makes criteria for the cells of a study."""

    def __init__(self, names: tuple[str, ...], rank: int) -> None:
        self.names, self.rank = names, rank

    def cells(self, prefix: str) -> naming.Seeds:
        return naming.seeds(self.names, prefix)

    def success(
        self,
        statistic: Callable[..., Any],
        prefixes: Sequence[str],
        *,
        measure: str,
        interval: Callable[..., Estimate] = statistics.bootstrap,
        **fields: Any,
    ) -> tuple[Criterion, ...]:
        """Make a criterion on a statistic of the success rates of some methods."""
        methods = [self.cells(prefix) for prefix in prefixes]
        if not all(methods):
            return ()
        number = published.compute(statistic, prefixes, self.rank)
        paper = None if number is None else float(number)

        def estimate(results: Results) -> Estimate:
            return interval(statistic, *(naming.outcomes(results, m) for m in methods))

        return (Criterion(measure, naming.flat(*methods), estimate, paper=paper, **fields),)

    def difference(self, a: str, b: str, **fields: Any) -> tuple[Criterion, ...]:
        """Make a criterion on the success of one method minus that of another."""
        return self.success(statistics.minus, (a, b), **fields)

    def seeds(
        self, values: Callable[..., list[float]], prefixes: Sequence[str], **fields: Any
    ) -> tuple[Criterion, ...]:
        """Make a criterion on a quantity with one value a seed."""
        methods = [self.cells(prefix) for prefix in prefixes]
        if not all(methods):
            return ()

        def estimate(results: Results) -> Estimate:
            return estimates.over_seeds(values(results, *methods))

        return (Criterion(cells=naming.flat(*methods), estimate=estimate, **fields),)


Criteria = Callable[[_Maker, str], tuple[Criterion, ...]]
"""Makes criteria for a backbone."""


def _lead(method: str, title: str, bound: float, reason: str) -> Criteria:
    """Return criteria on LoRA-SP's success minus that of another method."""

    def criteria(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
        pair = (f"{backbone}/multi/{each}" for each in ("lora_sp", method))
        shared: dict[str, Any] = {"side": "above", "bound": bound, "reason": reason}
        return make.difference(*pair, measure=f"LoRA-SP minus {title}", **shared)

    return criteria


def _needs_rank(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    rank = make.rank // 4
    return make.success(
        estimates.ratio,
        (f"{backbone}/multi/lora_r{rank}", f"{backbone}/multi/full"),
        measure=f"success of LoRA with r = R/4 = {rank}, relative to full fine-tuning",
        side="below",
        bound=0.95,
        unit="%",
        reason="the claim says 95 %; R/4 is the highest rank measured below R/2",
    )


def _multi_task(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    """Return criteria on LoRA of all ranks but R: [multi..., single...]."""
    ranks = naming.lora_ranks(make.names, backbone)
    # The paper has no rank of R/32.
    paper = [r for r in ranks if published.cell(f"{backbone}/multi/lora_r{r}", make.rank)]
    lora = [[f"{backbone}/{kind}/lora_r{r}" for r in paper] for kind in ("multi", "single")]
    if len(paper) < 2:
        return ()
    full = [f"{backbone}/{kind}/full" for kind in ("multi", "single")]
    low = [p for ps in lora for p in ps[:-1]]
    losses = make.success(
        _extra_shortfall,
        (*low, *full),
        measure="what LoRA with r < R lacks of full fine-tuning's success, averaged over r = "
        f"{', '.join(map(str, paper[:-1]))}: multi-task minus single-task",
        side="above",
        bound=0.0,
        reason=LESS_IS_NOTHING,
    )
    spreads = make.success(
        _extra_spread,
        (*lora[0], *lora[1]),
        measure="standard deviation of LoRA's success over tasks, averaged over r = "
        f"{', '.join(map(str, paper))}: multi-task minus single-task",
        interval=estimates.corrected,
        side="above",
        bound=0.0,
        reason=LESS_IS_NOTHING,
    )
    return losses + spreads


def _extra_shortfall(*rates: np.ndarray) -> np.ndarray:
    """Return the shortfall relative to full of n multi-task rates minus that of n single-task."""
    *lora, full_multi, full_single = rates
    half = len(lora) // 2
    multi = np.mean([estimates.ratio(rate, full_multi) for rate in lora[:half]], axis=0)
    single = np.mean([estimates.ratio(rate, full_single) for rate in lora[half:]], axis=0)
    return single - multi


def _extra_spread(*rates: np.ndarray) -> np.ndarray:
    spreads = [rate.std(-1) for rate in rates]
    half = len(spreads) // 2
    return np.mean(spreads[:half], axis=0) - np.mean(spreads[half:], axis=0)


def _embodiment(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    def more(tower: str, results: Results, unseen: Any, seen: Any) -> list[float]:
        shares = [[spectral_share(results[n], tower) for (n,) in m] for m in (unseen, seen)]
        return [a - b for a, b in zip(*shares, strict=True)]

    return tuple(
        criterion
        for tower in TOWERS
        for criterion in make.seeds(
            functools.partial(more, tower),
            (f"{backbone}/multi/full", f"{backbone}/panda/full"),
            measure=f"{tower}: share (0 to 1) of the singular values that hold 99 % of the "
            "energy of full fine-tuning's update, PiPER minus Panda",
            side="above",
            bound=0.0,
            unit="",
            reason=LESS_IS_NOTHING,
        )
    )


def spectral_share(cell: Any, tower: str) -> float:
    """Return a tower's share of singular values, averaged over the layers that changed."""
    layers = cell["measures"]["spectral_rank"][tower].values()
    return float(np.mean([share for row in layers for share in row if share is not None]))


def _spectral_loss(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    def ratio(results: Results, *methods: naming.Seeds) -> list[float]:
        ranks = [naming.per_seed(results, m, "active_rank", "mean") for m in methods]
        return [a / b for a, b in zip(*ranks, strict=True)]

    prefixes = f"{backbone}/multi/lora_sp", f"{backbone}/multi/lora_sp_no_spectral"
    paper = [sum(published.cell(p, make.rank).get("towers", ())) for p in prefixes]
    ranks = make.seeds(
        ratio,
        prefixes,
        measure="mean active rank with the spectral loss, relative to without",
        side="below",
        bound=0.9,
        unit="%",
        reason="a tenth is a quarter of the paper's reduction; less is not worth a loss term",
        paper=paper[0] / paper[1] if all(paper) else None,
    )
    cost = make.difference(
        *prefixes,
        measure="success with the spectral loss minus without",
        side="above",
        bound=-0.03,
        reason=THREE_POINTS,
    )
    return ranks + cost


def _saturates(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    sp = f"{backbone}/multi/lora_sp"
    gain = make.difference(
        f"{sp}_eta_0.99",
        sp,
        measure="success at η = .99 minus at η = .9",
        side="below",
        bound=0.03,
        reason=THREE_POINTS,
    )
    rise = make.difference(
        sp,
        f"{sp}_eta_0.8",
        measure="success at η = .9 minus at η = .8",
        side="above",
        bound=0.0,
        reason="success that is as high at .8 saturates earlier",
    )
    return gain + rise


def _towers(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    def ranks(results: Results, method: naming.Seeds) -> list[list[float]]:
        towers = (naming.per_seed(results, method, "active_rank", t) for t in TOWERS)
        return [list(seed) for seed in zip(*towers, strict=True)]

    def highest(results: Results, method: naming.Seeds) -> list[float]:
        return [v - max(l, a) for v, l, a in ranks(results, method)]

    def lowest(results: Results, method: naming.Seeds) -> list[float]:
        return [min(v, a) - l for v, l, a in ranks(results, method)]

    prefix = f"{backbone}/multi/lora_sp"
    paper = published.cell(prefix, make.rank).get("towers")
    shared: dict[str, Any] = {"side": "above", "bound": 0.0, "unit": ""}
    shared |= {"reason": LESS_IS_NOTHING, "maximum": float(make.rank)}
    ours = [rank * make.rank / published.RANK for rank in paper or ()]
    scaled = f"the paper's times {make.rank} / {published.RANK}"
    return make.seeds(
        highest,
        (prefix,),
        measure=f"active rank: vision minus the higher of language and action; {scaled}",
        paper=ours[0] - max(ours[1:]) if ours else None,
        **shared,
    ) + make.seeds(
        lowest,
        (prefix,),
        measure=f"active rank: the lower of vision and action, minus language; {scaled}",
        paper=min(ours[0], ours[2]) - ours[1] if ours else None,
        **shared,
    )


def _others(make: _Maker, backbone: str) -> tuple[Criterion, ...]:
    return tuple(
        criterion
        for method in ("ada_lora", "lora_moe_top1", "lora_moe_weighted")
        for criterion in make.difference(
            f"{backbone}/multi/{method}",
            f"{backbone}/multi/lora_r{make.rank}",
            measure=f"{naming.label(method, make.rank)} minus LoRA with r = {make.rank}",
            side="below",
            bound=0.03,
            reason=THREE_POINTS,
        )
    )


CLAIMS: tuple[tuple[str, str, Criteria], ...] = (
    (
        "Multi-task, LoRA-SP beats LoRA, r = R.",
        "Table I: 83.3 % against 60.0 % on π0, 91.7 % against 60.0 % on SmolVLA.",
        _lead("lora_r64", "LoRA with r = 64", 0.0, LESS_IS_NOTHING),
    ),
    (
        "Multi-task, LoRA-SP is at most 3 points below full fine-tuning.",
        "Table I: 83.3 % against 83.3 % on π0, 91.7 % against 86.7 % on SmolVLA.",
        _lead("full", "full fine-tuning", -0.03, THREE_POINTS),
    ),
    (
        "LoRA needs r of at least R/2 for 95 % of full fine-tuning's success.",
        "Figure 1: parity only near r = 128 on π0. Table II, multi-task, r = 32: 41.7 % against "
        "83.3 % on π0, 31.7 % against 86.7 % on SmolVLA.",
        _needs_rank,
    ),
    (
        "Rank matters more, and tasks differ more, in multi-task than in single-task training.",
        "Figure 3 and Table II: for π0, ranks below 128 lack 63 % of full fine-tuning's success in "
        "multi-task and 57 % in single-task training.",
        _multi_task,
    ),
    (
        "A robot that the base has never seen needs a higher spectral rank than one that it has "
        "seen, in every module.",
        "Figure 4: shares of 0.2 to 0.9 of the singular values, consistently higher for PiPER; "
        "numbers are not given.",
        _embodiment,
    ),
    (
        "The spectral loss lowers active ranks without costing success.",
        "Table III, SmolVLA: 83, 107, 57 (vision, language, action) to 84, 35, 34; success 78.3 % "
        "to 91.7 %.",
        _spectral_loss,
    ),
    (
        "Success saturates at an energy target of η = .9: .99 adds less than 3 points.",
        "Table IV, SmolVLA: 81.7 % at .8, 91.7 % at .9, 91.7 % at .99.",
        _saturates,
    ),
    (
        "Vision needs the highest active rank and language the lowest.",
        "Figure 6. Table III, SmolVLA: 84 vision, 35 language, 34 action, so action is not above "
        "language in the paper's own table.",
        _towers,
    ),
    (
        "AdaLoRA and LoRA-MoE do not beat LoRA (by 3 points or more).",
        "Table I, π0: LoRA 60.0 %, AdaLoRA 31.7 %, top-1 23.3 %, but the weighted sum 70.0 %; on "
        "SmolVLA 60.0, 16.7, 60.0 and 76.7 %. The paper's table itself has the weighted sum ahead.",
        _others,
    ),
    (
        "LoRA-SP beats LoRA that is cut after training to the same mean rank.",
        "Not in the paper. PARA (arXiv 2604.27796) reports that such a cut, by 75 to 90 % of the "
        "parameters, costs no quality, which speaks against the claim.",
        _lead("lora_cut", "LoRA cut after training to the same mean rank", 0.0, LESS_IS_NOTHING),
    ),
)
"""Statement, the paper's evidence, and the criteria."""
