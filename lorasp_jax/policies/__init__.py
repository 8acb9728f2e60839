"""Turn a backbone into a robot policy: inputs, normalization, prompts, actions."""

from lorasp_jax.policies import statistics_files, tokenizer
from lorasp_jax.policies.policy import Policy
from lorasp_jax.policies.processor import Processor
from lorasp_jax.policies.prompt_table import PromptTable

__all__ = ["Policy", "Processor", "PromptTable", "statistics_files", "tokenizer"]
