"""Simulate with MuJoCo MJX; only this folder and `rendering.warp` import MJX or Warp."""
