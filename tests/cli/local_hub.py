"""A hub on this machine: as much of Hugging Face's interface as an upload and a download ask for, over HTTP."""

import base64
import contextlib
import hashlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class LocalHub(ThreadingHTTPServer):
    """Keeps the files of the repositories that were made: `repositories[repo_id][path]`."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.repositories: dict[str, dict[str, bytes]] = {}

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: LocalHub

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        parts = self.path.strip("/").split("/")
        if parts[:3] == ["api", "repos", "create"]:
            asked = json.loads(body)
            repo_id = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
            self.server.repositories.setdefault(repo_id, {})
            self._answer({"url": f"{self.server.address}/{repo_id}", "name": repo_id})
        elif parts[4:5] == ["preupload"]:
            files = [
                {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False} for file in json.loads(body)["files"]
            ]
            self._answer({"files": files})
        elif parts[4:5] == ["commit"]:
            files = self.server.repositories["/".join(parts[2:4])]
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            url = f"{self.server.address}/{'/'.join(parts[2:4])}/commit/{COMMIT}"
            self._answer({"commitUrl": url, "commitOid": COMMIT, "success": True})
        else:
            self._answer({}, 200 if parts[-1] == "validate-yaml" else 404)

    def do_GET(self) -> None:
        parts = self.path.strip("/").split("?")[0].split("/")
        if parts[0] == "api":
            repo_id = "/".join(parts[2:4])
            known = repo_id in self.server.repositories
            files = self.server.repositories.get(repo_id, {})
            tree = [{"type": "file", "path": path, "size": len(files[path]), "oid": COMMIT} for path in files]
            about = {"id": repo_id, "sha": COMMIT, "siblings": [{"rfilename": path} for path in files]}
            self._answer(tree if parts[4:5] == ["tree"] else about, 200 if known else 404)
        else:  # /organization/name/resolve/revision/path
            content = self.server.repositories["/".join(parts[:2])]["/".join(parts[4:])]
            self._send(content, "application/octet-stream", 200)

    do_HEAD = do_GET  # noqa: N815

    def _answer(self, value: Any, status: int = 200) -> None:
        self._send(json.dumps(value).encode(), "application/json", status)

    def _send(self, content: bytes, kind: str, status: int) -> None:
        self.send_response(status)
        headers = {"Content-Type": kind, "Content-Length": len(content), "X-Repo-Commit": COMMIT}
        for name, value in {**headers, "ETag": f'"{hashlib.sha256(content).hexdigest()}"'}.items():
            self.send_header(name, str(value))
        if status == 404:
            self.send_header("X-Error-Code", "RepoNotFound")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Nothing."""


@contextlib.contextmanager
def running() -> Iterator[LocalHub]:
    """A hub that answers meanwhile."""
    with LocalHub() as hub:
        thread = threading.Thread(target=hub.serve_forever)
        thread.start()
        try:
            yield hub
        finally:
            hub.shutdown()
            thread.join()
