"""What is asked of a deformed body: outputs, one file each."""
