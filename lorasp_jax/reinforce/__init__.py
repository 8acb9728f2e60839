"""Online reinforcement learning of adapters: rollouts in simulation, proximal policy updates."""
