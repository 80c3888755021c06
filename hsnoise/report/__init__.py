"""One page of HTML about a capture and the results from it.

May import everything but the command line.
"""

from hsnoise.report.page import Found, check_path, page, write_report

__all__ = ["Found", "check_path", "page", "write_report"]
