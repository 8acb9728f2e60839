"""How many demonstrations does a policy need, and which method makes the most of them?"""
