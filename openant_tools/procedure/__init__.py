"""What every procedure yields and leaves behind: events, findings, the journal of writes."""
