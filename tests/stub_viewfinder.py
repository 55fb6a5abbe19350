"""An engine without a scene, for tests of the viewfinder's page: a bright square before a wall."""

import threading

import mitsuba as mi

SLIDERS = [
    ("twist", "Twist", 0, 1, 0.01, 1, False, "", ""),
    ("exposure", "Exposure", -8, 8, 0.1, 0, False, "stops", ""),
    ("filmic", "Filmic", 0, 1, 1, 0, False, "", ""),
    ("fov", "Field of view", 10, 120, 1, 60, False, "°", ""),
    ("focus_distance", "Focus", 0.1, 100, None, 1, True, "", ""),
    ("aperture_radius", "Aperture", 0, 0.5, 0.005, 0, False, "", ""),
    ("tolerance", "Tolerance", 1e-4, 1e-1, None, 1e-2, True, "", ""),
    ("max_depth", "Depth", 1, 32, 1, 8, False, "", "Compiles again, once."),
]
KEYS = ("name", "label", "min", "max", "step", "value", "log", "unit", "note")
XML = '<transform name="to_world">\n    <translate value="1, 2, 3"/>\n</transform>'


class Engine:
    """Shows a square of a tenth of the picture's height, and notes what the page has said.

    ``place`` is the square's in the picture (parts of its width and height). It moves as the hand
    drags it, a tenth of the height for each key pressed, and to the middle when it is aimed at.
    """

    def __init__(self, link):
        self.link = link
        self.heard = []
        self.sliders = {row[0]: dict(zip(KEYS, row)) for row in SLIDERS}
        self.place = [0.7, 0.3]
        self.room = None
        self.frame = 0
        self.keys = 0
        self.scale = 1  # so many pixels of the screen are one of the picture
        self.many = 0  # frames to show beside those that are asked for
        self.done = threading.Event()
        self.error = None

    def run(self):
        try:
            while not self.done.is_set():
                for message in self.link.messages(0.02):
                    self.heard.append(message)
                    getattr(self, message["do"])(**{k: v for k, v in message.items() if k != "do"})
                while self.many:
                    self.many -= 1
                    self.show()
        except Exception as error:  # for the test to raise: this is a thread of its own
            self.error = error

    def heard_of(self, do):
        return [message for message in self.heard if message["do"] == do]

    # ------------------------------------------------------------ what the page asks

    def hello(self, size):
        self.send_scene()
        self.room = size
        self.show()

    def size(self, size):
        self.room = size
        self.show()

    def look(self, by):
        self.place = [self.place[0] + by[0] * 9 / 16, self.place[1] + by[1]]
        self.show()

    def go(self, move, turn):
        self.place[0] += (move[0] + turn[0]) * 0.1 * 9 / 16
        self.place[1] += (move[1] + turn[1]) * 0.1
        self.show()

    def speed(self, by):
        self.link.send({"is": "says", "kind": "note", "text": f"Speed {by:+g}."})

    def point(self, at):
        if at is None:
            return
        hit = all(abs(a - b) < 0.05 for a, b in zip(at, self.place))
        about = ("square", [0, 0, 1], [0.5, -1.25, 1 / 3], 2.41) if hit else (None,) * 4
        names = ("shape", "cell", "position", "distance")
        self.link.send({"is": "under", "at": at, **dict(zip(names, about))})

    def aim(self, at):
        self.place = [a + 0.5 - b for a, b in zip(self.place, at)]
        self.show()

    def set(self, name, value):
        if name == "max_depth" and value > 16:
            value = 16
            self.link.send({"is": "value", "name": name, "value": value})
        self.sliders[name]["value"] = value
        self.show()

    def copy(self):
        options = f"-P twist={self.sliders['twist']['value']}"
        self.link.send({"is": "camera", "xml": XML, "options": options})

    def save(self):
        self.link.send({"is": "saved", "path": "scenes/room.view-1.xml"})

    def render(self):
        command = "nil-mitsuba render scenes/room.view-1.xml -P twist=1 --denoise --png room.png"
        self.link.send({"is": "command", "command": command})

    def key(self):
        self.keys += 1
        command = "nil-mitsuba fly scenes/room.xml --keys cameras.json --frames 120 -o frames/"
        self.link.send(
            {"is": "keys", "count": self.keys, "path": "cameras.json", "command": command}
        )

    def home(self):
        self.show()

    def bye(self):
        self.room = None

    # ----------------------------------------------------------------- what it shows

    def send_scene(self):
        self.link.send(
            {
                "is": "scene",
                "title": "room",
                "aspect": 16 / 9,
                "sliders": list(self.sliders.values()),
            }
        )

    def show(self):
        if not self.room:
            return
        width, height = self.room
        width = min(width, round(height * 16 / 9)) // self.scale
        height = round(width * 9 / 16)
        self.frame += 1
        header = {
            "frame": self.frame,
            "size": [width, height],
            "spp": 64,
            "moving": False,
            "fps": 9.5,
            "place": [0.12, -0.5, 0.75],
            "cell": [0, -1, 2],
            "speed": 0.5,
            "denoised": True,
        }
        while not self.link.show(header, self.picture(width, height)):
            if not self.link.viewer or self.done.wait(0.01):
                return

    def picture(self, width, height):
        """The JPEG file of the square, whose wall is the bluer, the greater the twist."""
        wall = bytes((40, 40, round(200 * self.sliders["twist"]["value"])))
        side = height // 10
        left, top = (round(a * size - side / 2) for a, size in zip(self.place, (width, height)))
        before, after = max(0, min(width, left)), max(0, min(width, left + side))
        empty = wall * width
        row = wall * before + b"\xff\xff\xff" * (after - before) + wall * (width - after)
        rows = [row if top <= y < top + side else empty for y in range(height)]
        ppm = b"P6\n%d %d\n255\n" % (width, height) + b"".join(rows)
        source, stream = mi.MemoryStream(), mi.MemoryStream()
        source.write(ppm)
        source.seek(0)
        mi.Bitmap(source).write(stream, mi.Bitmap.FileFormat.JPEG, 90)
        return stream.raw_buffer()
