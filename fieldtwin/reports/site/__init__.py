"""The site acceptance document: dumps, differences, comparisons and checks in one file that is printed and signed."""
