"""A PiPER without a PiPER: the tasks in MuJoCo's C engine, behind a virtual CAN bus.

    python -m lorasp_jax.extras.piper.fake --server ws://127.0.0.1:8000 --task press

The unmodified piper_sdk talks to it, so the client of a real arm runs as it is. python-can's
virtual bus lives inside one process: fake arm and client share it, only the policy is elsewhere.
In the scene `hand_over` there are two arms, each on a bus of its own.
"""
