"""Sections II and III: the uncertain system, the model of the delay, and the augmented system."""
