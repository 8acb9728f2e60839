"""Physics simulation; only this folder and `rendering.warp` import MJX or Warp."""
