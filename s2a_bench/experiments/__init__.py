"""What can be measured or tried: one folder each, with what it is asked, how it runs and how it is shown."""
