"""
Trainings that leave a record, many of them by one command, and what they come to: ``python -m sb3_ddiffpg.experiments``.
"""
