"""The parts that both backbones are made of."""
