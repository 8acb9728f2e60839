"""How far does trial in simulation take a policy of few demonstrations?"""
