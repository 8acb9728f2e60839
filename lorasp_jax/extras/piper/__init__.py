"""The AgileX PiPER as the client of a policy server, with safety checks.

python -m lorasp_jax.extras.piper --server ws://127.0.0.1:8000 --task press --dry-run
"""
