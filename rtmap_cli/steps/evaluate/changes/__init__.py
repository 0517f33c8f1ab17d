"""Changes found, missed and false, where they were in view, and after how many drives."""
