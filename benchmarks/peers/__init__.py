"""Time openpi, LeRobot, qwix and PEFT beside this project; see `studies/performance/peers.md`."""
