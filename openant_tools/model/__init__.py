"""Reading, changing and writing MJCF; rollouts in batches on all cores."""
