// WebGL2 in two passes: a material is shaded at the pixels of its maps, then the surface is drawn with it.

const MAPS = ["rendering", "normal", "diffuse", "roughness", "specular"];

class Renderer {
  constructor(canvas, shaders) {
    const gl = canvas.getContext("webgl2", {antialias: true, premultipliedAlpha: true});
    if (!gl) throw new Error("This browser does not offer WebGL2, which the viewer draws with.");
    this.gl = gl;
    this.canvas = canvas;
    this.anisotropy = gl.getExtension("EXT_texture_filter_anisotropic");
    this.shading = this.program(shaders["material.vert"], shaders["material.frag"]);
    this.drawing = this.program(shaders["surface.vert"], shaders["surface.frag"]);
    gl.bindVertexArray(gl.createVertexArray());
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  program(...sources) {
    const gl = this.gl;
    const handle = gl.createProgram();
    sources.forEach((source, i) => {
      const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(handle, shader);
    });
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(handle));
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); i++) {
      const {name} = gl.getActiveUniform(handle, i);
      uniforms[name] = gl.getUniformLocation(handle, name);
    }
    return {handle, uniforms};
  }

  // Bytes as they are in the file: no colour management, no alpha.
  async picture(base64) {
    const bytes = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
    return createImageBitmap(new Blob([bytes], {type: "image/png"}), {
      colorSpaceConversion: "none",
      premultiplyAlpha: "none",
    });
  }

  texture(picture, internal, format) {
    const gl = this.gl;
    const handle = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, handle);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, format, gl.UNSIGNED_BYTE, picture);
    picture.close();
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return handle;
  }

  // Mipmapped and filtered in linear light; 2D textures are clamped, since surfaces need not tile.
  smooth(handle) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, handle);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    if (this.anisotropy) gl.texParameterf(gl.TEXTURE_2D, this.anisotropy.TEXTURE_MAX_ANISOTROPY_EXT, 8);
    return handle;
  }

  async load(described) {
    const gl = this.gl;
    const pictures = await Promise.all(MAPS.slice(1).map((name) => this.picture(described.maps[name])));
    const photo = described.photo && (await this.picture(described.photo));
    const maps = pictures.map((picture) => this.texture(picture, gl.RGB8, gl.RGB));
    const shaded = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, shaded);
    const {width, height} = described;
    const levels = Math.floor(Math.log2(Math.max(width, height))) + 1;
    gl.texStorage2D(gl.TEXTURE_2D, levels, gl.SRGB8_ALPHA8, width, height);
    const target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, shaded, 0);
    return {
      described, maps, shaded, target,
      photo: photo && this.smooth(this.texture(photo, gl.SRGB8_ALPHA8, gl.RGBA)),
    };
  }

  release({maps, shaded, target, photo}) {
    for (const texture of [...maps, shaded, photo]) this.gl.deleteTexture(texture);
    this.gl.deleteFramebuffer(target);
  }

  shade(material, {map, light, eye, exposure}) {
    const gl = this.gl;
    const {handle, uniforms} = this.shading;
    gl.useProgram(handle);
    material.maps.forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(uniforms[`${MAPS[i + 1]}Map`], i);
    });
    gl.uniform1i(uniforms.shown, MAPS.indexOf(map));
    gl.uniform3fv(uniforms.lightPosition, light.position);
    gl.uniform3fv(uniforms.lightIntensity, light.intensity);
    gl.uniform1i(uniforms.inverseSquare, light.falloff === "inverse_square");
    gl.uniform4fv(uniforms.eye, eye);
    gl.uniform1f(uniforms.exposure, exposure);
    gl.bindFramebuffer(gl.FRAMEBUFFER, material.target);
    gl.viewport(0, 0, material.described.width, material.described.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.activeTexture(gl.TEXTURE0);
    this.smooth(material.shaded);
  }

  draw(material, matrix, compared, divider, viewport) {
    const gl = this.gl;
    const {handle, uniforms} = this.drawing;
    gl.viewport(0, 0, ...(viewport ?? [this.canvas.width, this.canvas.height]));
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(handle);
    [material.shaded, compared ?? material.shaded].forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(uniforms.material, 0);
    gl.uniform1i(uniforms.compared, 1);
    gl.uniform1f(uniforms.divider, compared ? divider : -1);
    gl.uniformMatrix4fv(uniforms.projection, false, matrix);
    gl.uniform2fv(uniforms.halfSize, halfSize(material.described));
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
