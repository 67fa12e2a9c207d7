"""The terminal program: screens that call procedures and draw what they find. It computes nothing of its own."""
