"""A PiPER without a PiPER: the tasks in MuJoCo's C engine, behind a virtual CAN bus.

The unmodified piper_sdk talks to it, so the driver of a real arm runs as it is. python-can's
virtual bus lives inside one process: fake arm and client share it, only the policy is elsewhere.
"""
