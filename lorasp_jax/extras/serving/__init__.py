"""Serve policies over websockets in openpi's protocol, and ask such servers for actions.

    python -m lorasp_jax.extras.serving runs/NAME

`client` and `wire` need only NumPy, msgpack and websockets. `exported` runs policies that `export`
wrote, and needs only JAX, NumPy and safetensors.
"""
