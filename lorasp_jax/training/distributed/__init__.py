"""Training on several devices and in several processes: mesh, start, barriers and joint exit."""
