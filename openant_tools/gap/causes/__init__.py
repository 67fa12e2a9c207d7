"""The catalogue of effects as causes of a gap, one file a cause: every module here with a `CAUSE` is one."""
