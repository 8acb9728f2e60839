"""Time openpi, LeRobot, qwix and Hugging Face PEFT beside this project; see `peers.md`."""
