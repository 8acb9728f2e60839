"""How many flow steps does a policy need, and when do fewer cost success?"""
