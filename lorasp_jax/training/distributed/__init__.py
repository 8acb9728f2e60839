"""Training on several devices and in several processes: mesh, startup, barriers and exit."""
