"""Combine several adapters of one layer into a single method, their weighted sum.

    y = x W + Σ_i w_i Δ_i(x)

The weights w are an array, so choosing other adapters does not recompile. For a method that is not
additive (DoRA), Δ_i is its output minus x W.

LoRAs are padded to a common rank and share one bank. One matmul computes the down-projections of
all additive adapters, and another their up-projections. Everything else runs separately for each
adapter that is not a LoRA. Adapters with weight 0 are computed too.
"""

import dataclasses
import itertools
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.kernels.frozen_matmul import frozen_matmul
from lorasp_jax.peft import Aux, LoRA, Method
from lorasp_jax.peft.method import Mask, Params


class AdapterChoice(nnx.Variable[Any]):
    """Weights of a layer's A adapters: f32 `[..., A]`, or `[..., B, A]` for B examples."""


class AdapterSetParam(nnx.Param[Any]):
    """Parameters of a layer's adapters, frozen while they are combined."""


class NamedAdapters(nnx.Module):
    """A layer's `adapter` in a combined model: the parameters of an `AdapterSet`.

    In stacked layers, all arrays have the leading axes of the stack.

    Attributes:
        choice: the weights.
        params: all other parameters.
    """

    def __init__(self, params: Params, choice: jax.Array) -> None:
        self.choice: AdapterChoice = AdapterChoice(choice)
        self.params: AdapterSetParam = AdapterSetParam(params)

    def get_value(self) -> Params:
        """All parameters of the `AdapterSet`."""
        return {"choice": self.choice.get_value(), **self.params.get_value()}


@dataclasses.dataclass(frozen=True)
class AdapterSet(Method):
    """Weighted sum of A adapters.

    Parameters:
        choice: w, f32 `[A]`, or `[B, A]` with a row per example. Inputs then have k B rows, with k
            contiguous rows per example.
        bank: K LoRAs padded to one rank R: lora_a [I, K, R], lora_b [K, R, O], scale f32 [K] and
            rank int32 `[K]`. The rank is 0 for an adapter that the layer does not have.
        others: parameters of the other adapters, by name.
    """

    names: tuple[str, ...]
    """Names of all A adapters."""
    methods: tuple[Method | None, ...]
    """Method of each adapter; None if it is in the bank."""

    is_low_rank_sum: ClassVar[bool] = False

    @property
    def bank_names(self) -> list[str]:
        """Names of the K adapters in the bank."""
        return [name for name, method in zip(self.names, self.methods, strict=True) if not method]

    @property
    def others(self) -> dict[str, Method]:
        """Methods of the adapters that are not in the bank, by name."""
        return {n: m for n, m in zip(self.names, self.methods, strict=True) if m is not None}

    @property
    def down_in_fp32(self) -> bool:
        """Whether any adapter needs its down-projection in fp32."""
        return any(method.down_in_fp32 for method in self.others.values())

    def down(self, params: Params) -> jax.Array:
        """Down-projections `[I, ...]` of the bank and the other additive adapters, concatenated."""
        bank = params["bank"]["lora_a"]
        return jnp.concatenate(
            [bank.reshape(len(bank), -1), *self._other_matrices(params, "down")], axis=1
        )

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: Mask
    ) -> tuple[jax.Array, Aux]:
        """Multiply each adapter's z by its weight; no losses, since sets are not trained."""
        weights, bank = self._weights(params["choice"], rows), params["bank"]
        bank_weights = _stack([weights[name] for name in self.bank_names])
        columns = jnp.repeat(bank_weights * bank["scale"], bank["lora_a"].shape[-1], axis=-1)
        widths = [
            columns.shape[-1],
            *(matrix.shape[1] for matrix in self._other_matrices(params, "down")),
        ]
        first, *parts = jnp.split(rows, list(itertools.accumulate(widths))[:-1], axis=-1)
        z = [first * columns.astype(rows.dtype)]
        rank = jnp.sum((bank_weights != 0) * bank["rank"], axis=-1).astype(jnp.float32)
        for (name, method), part in zip(self._additive_others(), parts, strict=True):
            own_params = params["others"][name]
            f = method.implementation(own_params)
            own_z, aux = f.bottleneck(method.bottleneck_params(own_params), part, token_mask)
            z.append(weights[name][..., None] * own_z)
            rank += _active_rank(weights[name], aux)
        return jnp.concatenate(z, axis=-1), Aux(jnp.broadcast_to(rank, rows.shape[:-1]))

    def up(self, params: Params) -> jax.Array:
        """Up-projections `[..., O]` of the bank and the other additive adapters, concatenated."""
        bank = params["bank"]["lora_b"]
        return jnp.concatenate(
            [bank.reshape(-1, bank.shape[-1]), *self._other_matrices(params, "up")]
        )

    def apply(
        self, params: Params, x: jax.Array, kernel: jax.Array, *, token_mask: Mask = None
    ) -> tuple[jax.Array, Aux]:
        """Compute x @ kernel + Σ_i w_i Δ_i(x), `[...tokens, O]`; arguments as for `Method.apply`.

        The active rank is the sum over adapters with non-zero weight.
        """
        y, aux = super().apply(params, x, kernel, token_mask=token_mask)
        rank, weights = aux.active_rank, self._weights(params["choice"], x)
        assert rank is not None
        for name, method in self.others.items():
            if not method.additive:
                own_params = params["others"][name]
                adapted, own_aux = method.apply(own_params, x, kernel, token_mask=token_mask)
                delta = adapted - frozen_matmul(x, kernel)
                y += weights[name].astype(x.dtype)[..., None] * delta
                rank += _active_rank(weights[name], own_aux)
        return y, dataclasses.replace(aux, active_rank=rank)

    def _additive_others(self) -> list[tuple[str, Method]]:
        """Names and methods of the additive adapters that are not in the bank."""
        return [(name, method) for name, method in self.others.items() if method.additive]

    def _other_matrices(self, params: Params, side: Literal["down", "up"]) -> list[jax.Array]:
        """The down- or up-projection of each of `_additive_others`."""
        return [
            getattr(method, side)(params["others"][name])
            for name, method in self._additive_others()
        ]

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """Compute W + Σ_i w_i ΔW_i in fp32.

        Raises:
            ValueError: the weights are per example, or a delta depends on the input.
        """
        if params["choice"].ndim > 1:
            raise ValueError("adapters are chosen per example: choose one for the batch first")
        base, bank = kernel.astype(jnp.float32), params["bank"]
        weights = dict(zip(self.names, params["choice"], strict=True))
        scale = bank["scale"] * _stack([weights[name] for name in self.bank_names])
        merged = base + jnp.einsum("ikr,k,kro->io", bank["lora_a"], scale, bank["lora_b"])
        for name, method in self.others.items():
            merged += weights[name] * (method.merge(params["others"][name], base) - base)
        return merged.astype(kernel.dtype)

    def _weights(self, choice: jax.Array, x: jax.Array) -> dict[str, jax.Array]:
        """Weights by name: scalars, or [rows, 1, ...] to broadcast over the tokens of x."""
        if choice.ndim > 1:
            examples, rows = len(choice), x.shape[0] if x.ndim > 1 else 1
            if rows % examples:
                raise ValueError(f"adapters for {examples} examples do not fit {rows} rows")
            choice = jnp.repeat(choice, rows // examples, axis=0)
            choice = choice.reshape(rows, *(1 for _ in x.shape[1:-1]), -1)
        return {name: choice[..., i] for i, name in enumerate(self.names)}


def empty_bank(size: int, rank: int, shape: tuple[int, ...]) -> Params:
    """Create a bank with `size` empty slots for LoRAs up to `rank`, for kernels `[..., I, O]`."""
    *leading, d_in, d_out = shape
    return {
        "lora_a": jnp.zeros((*leading, d_in, size, rank)),
        "lora_b": jnp.zeros((*leading, size, rank, d_out)),
        "scale": jnp.zeros((*leading, size)),
        "rank": jnp.zeros((*leading, size), jnp.int32),
    }


def set_slot(bank: Params, slot: int, method: LoRA | None, params: Params) -> Params:
    """Store a LoRA in a slot of the bank, or clear the slot if method is None.

    Raises:
        ValueError: the LoRA's rank exceeds the bank's.
    """
    bank, rank = dict(bank), 0 if method is None else method.rank
    capacity = bank["lora_a"].shape[-1]
    if rank > capacity:
        raise ValueError(f"LoRA rank {rank} exceeds {capacity}: combine with a larger rank")
    a, b = bank["lora_a"].at[..., slot, :].set(0), bank["lora_b"].at[..., slot, :, :].set(0)
    if method is not None:
        a = a.at[..., slot, :rank].set(params["lora_a"])
        b = b.at[..., slot, :rank, :].set(params["lora_b"])
    scale = bank["scale"].at[..., slot].set(0.0 if method is None else method.scale)
    ranks = bank["rank"][..., slot]
    ranks = jnp.array(method.ranks).reshape(ranks.shape) if method and method.ranks else rank
    ranks = bank["rank"].at[..., slot].set(ranks)
    return {"lora_a": a, "lora_b": b, "scale": scale, "rank": ranks}


def get_slot(bank: Params, slot: int) -> tuple[LoRA | None, Params]:
    """The LoRA in a slot and its parameters, or (None, None) if the slot is empty."""
    rank = int(bank["rank"][..., slot].max())
    if not rank:
        return None, None
    scale = float(bank["scale"][..., slot].max())
    params = {
        "lora_a": bank["lora_a"][..., slot, :rank],
        "lora_b": bank["lora_b"][..., slot, :rank, :],
    }
    ranks = tuple(bank["rank"][..., slot].ravel().tolist())
    ranks = ranks if min(ranks) < rank else ()
    return LoRA(rank=rank, alpha=scale * rank, ranks=ranks), params


def _active_rank(weight: jax.Array, aux: Aux) -> jax.Array:
    """Active rank of an adapter, 0 where its weight is 0."""
    return jnp.where(weight != 0, 0.0 if aux.active_rank is None else aux.active_rank, 0.0)


def _stack(values: list[jax.Array]) -> jax.Array:
    """Stack weights `[..., K]`; K may be 0."""
    return jnp.stack(values, axis=-1) if values else jnp.zeros(0)
