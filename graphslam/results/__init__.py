"""The result folder and its file formats; the HTML reports and their figures."""
