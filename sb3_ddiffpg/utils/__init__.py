"""What nothing of ours lies below: random states, signals, schedules, full disks, training that diverges."""
