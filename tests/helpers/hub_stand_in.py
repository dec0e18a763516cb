"""A server on this machine that answers as the Hugging Face hub does, for as much as we ask it."""

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

COMMIT = "a" * 40


class Hub(ThreadingHTTPServer):
    """Holds the files of repositories in memory."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files = {}  # repository -> file -> content

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_POST(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        repository = "/".join(self.path.split("/")[3:5])
        if self.path == "/api/repos/create":
            request = json.loads(body)
            name = "/".join(filter(None, [request.get("organization"), request["name"]]))
            self.server.files.setdefault(name, {})
            self.answer({"url": f"{self.server.address}/{name}", "name": name, "id": name})
        elif self.path == "/api/validate-yaml":  # of the card
            self.answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            names = [file["path"] for file in json.loads(body)["files"]]
            self.answer({"files": [_inline(name) for name in names]})
        elif "/commit/" in self.path:
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    content = base64.b64decode(line["value"]["content"])
                    self.server.files[repository][line["value"]["path"]] = content
            url = f"{self.server.address}/{repository}/commit/{COMMIT}"
            self.answer({"success": True, "commitUrl": url, "commitOid": COMMIT, "hookOutput": ""})
        else:
            self.answer({"error": self.path}, 404)

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        parts = self.path.split("?")[0].strip("/").split("/")
        if parts[0] == "api":
            repository = "/".join(parts[2:4])
            stored = self.server.files.get(repository)
            if stored is None:
                self.answer({"error": "Repository not found"}, 404)
            elif len(parts) > 4 and parts[4] == "tree":
                tree = [
                    {"type": "file", "path": n, "size": len(c), "oid": hashlib.sha1(c).hexdigest()}
                    for n, c in stored.items()
                ]
                self.answer(tree)
            else:
                siblings = [{"rfilename": name} for name in stored]
                self.answer({"id": repository, "sha": COMMIT, "siblings": siblings})
        else:
            content = self.server.files["/".join(parts[:2])]["/".join(parts[4:])]
            etag = hashlib.sha1(content).hexdigest()
            self.send(content, {"X-Repo-Commit": COMMIT, "ETag": f'"{etag}"'})

    def answer(self, value, status=200):
        self.send(json.dumps(value).encode(), {"Content-Type": "application/json"}, status)

    def send(self, content, headers, status=200):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


def _inline(name):
    return {"path": name, "uploadMode": "regular", "shouldIgnore": False}


@pytest.fixture
def hub(monkeypatch, tmp_path):
    module = pytest.importorskip("huggingface_hub", reason="the extra `hub` is not installed")
    server = Hub()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    api = type("Api", (module.HfApi,), {})
    monkeypatch.setattr(module, "HfApi", lambda: api(endpoint=server.address, token="hf_x"))
    download = module.snapshot_download
    monkeypatch.setattr(
        module,
        "snapshot_download",
        lambda *args, **more: download(*args, endpoint=server.address, token="hf_x", **more),
    )
    yield server
    server.shutdown()
    server.server_close()
