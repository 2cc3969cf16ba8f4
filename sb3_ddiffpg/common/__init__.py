"""What all algorithms of this package share."""
