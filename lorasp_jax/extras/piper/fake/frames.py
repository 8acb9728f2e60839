"""CAN frames of the PiPER: what the arm sends and what it understands.

Identifiers and layouts are those of piper_sdk 0.6.2 (`piper_protocol_v2.py`): standard identifiers,
8 bytes, big-endian; angles in 0.001 degrees, lengths in 0.001 mm.
"""

import struct

JOINTS = (0x2A5, 0x2A6, 0x2A7)
GRIPPER, STATUS = 0x2A8, 0x2A1
DRIVERS = tuple(range(0x261, 0x267))
FIRMWARE_LIMITS = 0x473
TARGETS = (0x155, 0x156, 0x157)
GRIPPER_TARGET, MODE, STOP_OR_TEACH = 0x159, 0x151, 0x150
ENABLE, ASK_LIMITS = 0x471, 0x472
ENABLED = 0x40  # bit of a driver's status


def pair(first: float, second: float) -> bytes:
    """Pack two joint angles [0.001 degrees]."""
    return struct.pack(">2i", round(first), round(second))


def unpack_pair(data: bytes) -> tuple[int, int]:
    """Unpack two joint targets [0.001 degrees]."""
    first, second = struct.unpack(">2i", data[:8])
    return first, second


def gripper(opening: float, effort: float, enabled: bool) -> bytes:
    """Pack the gripper's opening [0.001 mm], effort [0.001 N m] and status."""
    return struct.pack(">ihBx", round(opening), round(effort), ENABLED if enabled else 0)


def unpack_gripper(data: bytes) -> tuple[int, int, int]:
    """Unpack target opening [0.001 mm], effort [0.001 N m] and the enable code."""
    opening, effort, code, _ = struct.unpack(">iHBB", data[:8])
    return opening, effort, code


def status(ctrl_mode: int, arm_status: int, teaching: int) -> bytes:
    """Pack control mode, arm status and teaching status, in MOVE J."""
    return bytes([ctrl_mode, arm_status, 0x01, teaching, 0, 0, 0, 0])


def driver(enabled: bool) -> bytes:
    """Pack a driver's state: 24 V, 30 degrees, 1 A."""
    return struct.pack(">HhbBH", 240, 30, 30, ENABLED if enabled else 0, 1000)


def firmware_limits(joint: int, low: float, high: float, speed: float) -> bytes:
    """Pack a joint's limits: number from 1, angles [degrees] and speed [rad/s]."""
    return struct.pack(">BhhHx", joint, round(10 * high), round(10 * low), round(1000 * speed))
