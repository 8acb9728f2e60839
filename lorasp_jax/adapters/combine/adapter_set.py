"""Several adapters of one layer as one method: a sum whose weights are data.

    y = x W + Σ_i w_i Δ_i(x)

The weights w belong to the arrays and not to the structure: another choice of adapters is another
array, and nothing is compiled again. Of a method that is not additive (DoRA), Δ_i is what it makes
of x W less x W. All LoRAs share one bank, padded to one rank, and cost one matrix product on either
side; other methods are computed one after the other, also where their weight is 0.
"""

import dataclasses
import itertools
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from lorasp_jax.peft import Aux, LoRA, Method
from lorasp_jax.peft._method import Params


class AdapterChoice(nnx.Variable[Any]):
    """The weights of a layer's adapters, f32 [..., A] or, for each example, [..., B, A]."""


class SetParam(nnx.Param[Any]):
    """The parameters of a layer's adapters. They are frozen: adapters train before or after."""


class NamedAdapters(nnx.Module):
    """What a layer of a combined model holds in the place of one adapter.

    Attributes:
      choice: `AdapterChoice`, and params: `SetParam`, all else of an `AdapterSet`'s parameters. In
        a stack of layers both carry its leading axes.
    """

    def __init__(self, params: Params, choice: jax.Array) -> None:
        """Wraps the arrays."""
        self.choice: AdapterChoice = AdapterChoice(choice)
        self.params: SetParam = SetParam(params)

    def get_value(self) -> Params:
        """The parameters of the `AdapterSet`."""
        return {"choice": self.choice.get_value(), **self.params.get_value()}


@dataclasses.dataclass(frozen=True)
class AdapterSet(Method):
    """The weighted sum of A adapters.

    Parameters:
      choice: w, f32 [A], or [B, A] where each example of a batch has its own: inputs then have
        B rows, or k B, of which k in turn belong to an example.
      bank: K LoRAs padded to one rank R, lora_a [I, K, R], lora_b [K, R, O], scale f32 [K] and rank
        int32 [K], which is 0 for an adapter that the layer does not have.
      others: the parameters of the other adapters by name.
    """

    names: tuple[str, ...]
    """A names."""
    methods: tuple[Method | None, ...]
    """The methods; None is a place in the bank."""

    @property
    def banked(self) -> list[str]:
        """Names of the K adapters in the bank."""
        return [name for name, method in zip(self.names, self.methods, strict=True) if not method]

    @property
    def others(self) -> dict[str, Method]:
        """The methods of the adapters outside of the bank, by name."""
        return {n: m for n, m in zip(self.names, self.methods, strict=True) if m is not None}

    @property
    def down_in_fp32(self) -> bool:
        """True if one of the adapters does."""
        return any(method.down_in_fp32 for method in self.others.values())

    def down(self, params: Params) -> jax.Array:
        """[I, ...], of the bank and of all that add to x W, side by side."""
        bank = params["bank"]["lora_a"]
        return jnp.concatenate([bank.reshape(len(bank), -1), *self._sides(params, "down")], axis=1)

    def bottleneck(
        self, params: Params, rows: jax.Array, token_mask: jax.Array | None
    ) -> tuple[jax.Array, Aux]:
        """Each adapter's own z times its weight. There are no losses: a set does not train."""
        weights, bank = self._weights(params["choice"], rows), params["bank"]
        own = _stack([weights[name] for name in self.banked])
        columns = jnp.repeat(own * bank["scale"], bank["lora_a"].shape[-1], axis=-1)
        widths = [columns.shape[-1], *(side.shape[1] for side in self._sides(params, "down"))]
        first, *parts = jnp.split(rows, list(itertools.accumulate(widths))[:-1], axis=-1)
        z = [first * columns.astype(rows.dtype)]
        rank = jnp.sum((own != 0) * bank["rank"], axis=-1).astype(jnp.float32)
        for (name, method), part in zip(self._adding(), parts, strict=True):
            own_params = params["others"][name]
            run = method.fused_kernel(own_params) or method
            more, aux = run.bottleneck(method.bottleneck_params(own_params), part, token_mask)
            z.append(weights[name][..., None] * more)
            rank += _active_rank(weights[name], aux)
        return jnp.concatenate(z, axis=-1), Aux(jnp.broadcast_to(rank, rows.shape[:-1]))

    def up(self, params: Params) -> jax.Array:
        """[..., O], of the bank and of all that add to x W, one below the other."""
        bank = params["bank"]["lora_b"]
        return jnp.concatenate([bank.reshape(-1, bank.shape[-1]), *self._sides(params, "up")])

    def apply(
        self,
        params: Params,
        x: jax.Array,
        kernel: jax.Array,
        *,
        token_mask: jax.Array | None = None,
    ) -> tuple[jax.Array, Aux]:
        """x @ kernel + Σ_i w_i Δ_i(x), [...tokens, O]; arguments as for `Method.apply`.

        The active rank is that of the adapters whose weight is not 0.
        """
        y, aux = super().apply(params, x, kernel, token_mask=token_mask)
        rank, weights = aux.active_rank, self._weights(params["choice"], x)
        assert rank is not None
        for name, method in self.others.items():
            if not method.additive:
                own = params["others"][name]
                adapted, other = method.apply(own, x, kernel, token_mask=token_mask)
                change = adapted - x @ jax.lax.stop_gradient(kernel.astype(x.dtype))
                y += weights[name].astype(x.dtype)[..., None] * change
                rank += _active_rank(weights[name], other)
        return y, dataclasses.replace(aux, active_rank=rank)

    def _adding(self) -> list[tuple[str, Method]]:
        """Name and method of the adapters outside of the bank that add to x W."""
        return [(name, method) for name, method in self.others.items() if method.additive]

    def _sides(self, params: Params, side: Literal["down", "up"]) -> list[jax.Array]:
        """One side of each of those adapters."""
        return [getattr(method, side)(params["others"][name]) for name, method in self._adding()]

    def merge(self, params: Params, kernel: jax.Array) -> jax.Array:
        """W + Σ_i w_i ΔW_i, summed in fp32.

        Raises:
          ValueError: each example has its own weights, or one of the deltas depends on the input.
        """
        if params["choice"].ndim > 1:
            raise ValueError("each example of a batch has its own adapters: choose for all first.")
        base, bank = kernel.astype(jnp.float32), params["bank"]
        weights = dict(zip(self.names, params["choice"], strict=True))
        scale = bank["scale"] * _stack([weights[name] for name in self.banked])
        merged = base + jnp.einsum("ikr,k,kro->io", bank["lora_a"], scale, bank["lora_b"])
        for name, method in self.others.items():
            merged += weights[name] * (method.merge(params["others"][name], base) - base)
        return merged.astype(kernel.dtype)

    def _weights(self, choice: jax.Array, x: jax.Array) -> dict[str, jax.Array]:
        """Each adapter's weight by name, a scalar or [rows, 1, ...] for the tokens of x."""
        if choice.ndim > 1:
            examples, rows = len(choice), x.shape[0] if x.ndim > 1 else 1
            if rows % examples:
                raise ValueError(
                    f"adapters were chosen for {examples} examples, but a layer sees {rows} rows."
                )
            choice = jnp.repeat(choice, rows // examples, axis=0)
            choice = choice.reshape(rows, *(1 for _ in x.shape[1:-1]), -1)
        return {name: choice[..., i] for i, name in enumerate(self.names)}


def empty_bank(size: int, rank: int, shape: tuple[int, ...]) -> Params:
    """A bank of K places for LoRAs up to a rank, for kernels [..., I, O]."""
    *leading, d_in, d_out = shape
    return {
        "lora_a": jnp.zeros((*leading, d_in, size, rank)),
        "lora_b": jnp.zeros((*leading, size, rank, d_out)),
        "scale": jnp.zeros((*leading, size)),
        "rank": jnp.zeros((*leading, size), jnp.int32),
    }


def set_slot(bank: Params, slot: int, method: LoRA | None, params: Params) -> Params:
    """The bank with another LoRA in a place, or with none.

    Raises:
      ValueError: the LoRA's rank exceeds the bank's.
    """
    bank, rank = dict(bank), 0 if method is None else method.rank
    capacity = bank["lora_a"].shape[-1]
    if rank > capacity:
        raise ValueError(f"a LoRA of rank {rank} needs more than the room for rank {capacity}.")
    a, b = bank["lora_a"].at[..., slot, :].set(0), bank["lora_b"].at[..., slot, :, :].set(0)
    if method is not None:
        a = a.at[..., slot, :rank].set(params["lora_a"])
        b = b.at[..., slot, :rank, :].set(params["lora_b"])
    scale = bank["scale"].at[..., slot].set(0.0 if method is None else method.scale)
    ranks = bank["rank"].at[..., slot].set(rank)
    return {"lora_a": a, "lora_b": b, "scale": scale, "rank": ranks}


def get_slot(bank: Params, slot: int) -> tuple[LoRA | None, Params]:
    """The LoRA in a place with its own rank and scale, or None and None; inverse of `put`."""
    rank = int(bank["rank"][..., slot].max())
    if not rank:
        return None, None
    scale = float(bank["scale"][..., slot].max())
    params = {
        "lora_a": bank["lora_a"][..., slot, :rank],
        "lora_b": bank["lora_b"][..., slot, :rank, :],
    }
    return LoRA(rank=rank, alpha=scale * rank), params


def _active_rank(weight: jax.Array, aux: Aux) -> jax.Array:
    """The active rank of an adapter, 0 where it has no weight."""
    return jnp.where(weight != 0, 0.0 if aux.active_rank is None else aux.active_rank, 0.0)


def _stack(values: list[jax.Array]) -> jax.Array:
    """Weights side by side, [..., K], also where K is 0."""
    return jnp.stack(values, axis=-1) if values else jnp.zeros(0)
