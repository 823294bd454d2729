"""Chromium without a window, spoken to over its pipe for debuggers: what a page looks like and what it complains of."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
#: Seconds that an answer may take.
PATIENCE = 60


def executable():
    """Where it is; None where there is none."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """One page in one browser.

    Attributes:
        complaints: What was written to its console as an error or a warning, and exceptions.
        requests: Addresses that were asked for, but for data in the page itself.
    """

    def __init__(self, folder):
        read, self._out = os.pipe()
        self._in, write = os.pipe()
        options = ['--headless', '--disable-gpu', '--no-first-run', '--disable-background-networking', '--disable-sync',
                   '--disable-component-update', f'--user-data-dir={folder}', '--remote-debugging-pipe']
        options += ['--no-sandbox'] if os.geteuid() == 0 else []
        # The pipe is at 3 and 4; it is not known where these are now, so both are moved out of the way first.
        command = f'exec 8<&{read} 9>&{write} 3<&8 4>&9 "$@"'
        self._process = subprocess.Popen(
            ['bash', '-c', command, 'browser', executable(), *options, 'about:blank'], pass_fds=(read, write),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(read)
        os.close(write)
        self._buffer, self._count, self._session = b'', 0, None
        self.complaints, self.requests = [], []
        [target] = [each for each in self.call('Target.getTargets')['targetInfos'] if each['type'] == 'page']
        self._session = self.call('Target.attachToTarget', targetId=target['targetId'], flatten=True)['sessionId']
        for domain in ('Page', 'Log', 'Runtime', 'Network'):
            self.call(f'{domain}.enable')

    def close(self):
        self._session = None
        with contextlib.suppress(OSError, TimeoutError):
            self.call('Browser.close')
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method, **parameters):
        """What the browser answers."""
        self._count += 1
        message = {'id': self._count, 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        while (answer := self._message()).get('id') != self._count:
            self._note(answer)
        if 'error' in answer:
            raise RuntimeError(f'{method}: {answer["error"]}')
        return answer['result']

    def _message(self):
        end = time.monotonic() + PATIENCE
        while b'\0' not in self._buffer:
            if not select.select([self._in], [], [], max(0, end - time.monotonic()))[0]:
                raise TimeoutError('the browser says nothing')
            data = os.read(self._in, 1 << 20)
            if not data:
                raise OSError('the browser is gone')
            self._buffer += data
        line, self._buffer = self._buffer.split(b'\0', 1)
        return json.loads(line)

    def _note(self, event):
        method, told = event.get('method'), event.get('params', {})
        if method == 'Runtime.exceptionThrown':
            self.complaints.append(told['exceptionDetails']['text'])
        elif method == 'Log.entryAdded' and told['entry']['level'] in ('error', 'warning'):
            self.complaints.append(told['entry']['text'])
        elif method == 'Runtime.consoleAPICalled' and told['type'] in ('error', 'warning'):
            self.complaints.append(str(told['args']))
        elif method == 'Network.requestWillBeSent' and not told['request']['url'].startswith('data:'):
            self.requests.append(told['request']['url'])

    def open(self, path, width=1280, height=900, scheme='light', media='screen'):
        """Show a file, as wide as that, and wait until all of it is there."""
        self.complaints.clear()
        self.requests.clear()
        phone = width < 600
        self.call('Emulation.setDeviceMetricsOverride', width=width, height=height, deviceScaleFactor=2 if phone else 1,
                  mobile=phone)
        self.call('Emulation.setEmulatedMedia', media=media,
                  features=[{'name': 'prefers-color-scheme', 'value': scheme}])
        self.call('Page.navigate', url=path.resolve().as_uri())
        end = time.monotonic() + PATIENCE
        while self.value('document.readyState + location.protocol') != 'completefile:':
            assert time.monotonic() < end
            time.sleep(0.02)

    def value(self, expression):
        """Of an expression in JavaScript."""
        answer = self.call('Runtime.evaluate', expression=expression, returnByValue=True, awaitPromise=True)
        assert 'exceptionDetails' not in answer, answer
        return answer['result'].get('value')

    def screenshot(self, path, *, whole=True):
        """A picture of all of the page, or of what is seen at once."""
        picture = self.call('Page.captureScreenshot', format='png', captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(picture['data']))

    def pdf(self, path):
        """The page as it is printed."""
        path.write_bytes(base64.b64decode(self.call('Page.printToPDF', printBackground=False)['data']))
